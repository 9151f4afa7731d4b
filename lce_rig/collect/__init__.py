"""From recordings and attached sensors to a session of captures."""
