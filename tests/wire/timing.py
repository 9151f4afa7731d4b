"""Which part of a reel is shown when: all senders read it off the time of day, and so agree unasked."""

BLOCK_NS = 110_592
#: From one data packet of a VLP-16 to the next.
PACKET_NS = 12 * BLOCK_NS
#: Three revolutions of 904 blocks: the shortest stretch that fills whole packets.
SCANS_PER_LOOP, PACKETS_PER_LOOP = 3, 226
LOOP_NS = PACKETS_PER_LOOP * PACKET_NS


def placement_at(time_ns, loops_per_hold, n_placements):
    """Return the placement of the board that is shown at a time of day."""
    return time_ns // LOOP_NS // loops_per_hold % n_placements
