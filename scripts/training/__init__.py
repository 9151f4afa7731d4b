"""Training of the event-to-image network: scenes, simulated events, network and loss; needs the extra `train`."""
