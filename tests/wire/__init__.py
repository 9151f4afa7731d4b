"""A rig on the wire: simulated sensors that send over UDP, pipes and sockets, in real time."""
