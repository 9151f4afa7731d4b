"""The board in event streams: limits, flicker, figures."""
