"""Training of the event-to-image network: scenes, events, network, loss; needs the extra `train`."""
