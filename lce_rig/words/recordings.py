"""What was skipped, repaired or assumed while a recording was read."""

from lce_rig.words.rendering import Phrase

PHRASES = {
    "recording.broken_packets": Phrase("{n} broken packets skipped (first: {where})"),
    "recording.torn_end": Phrase("{n} torn ends of the file skipped (first: {where})"),
    "recording.trigger_packets": Phrase("{n} packets of triggers skipped"),
    "recording.events_untimed": Phrase("{n} events before the first timestamp skipped"),
    "recording.time_words_repaired": Phrase("{n} inconsistent time words repaired"),
    "recording.unknown_words": Phrase("{n} words of no known code skipped"),
    "recording.packets_lost": Phrase("{n} packets lost in recording (first: {where})"),
    "recording.bag_torn": Phrase("{n} places where the bag is torn (first: {where})"),
    "recording.events_beyond_clocks": Phrase("{n} events with timestamps beyond any clock skipped"),
    "recording.events_before_clock_set": Phrase(
        "{n} events before the clock was set skipped (first: {where})"
    ),
    "recording.events_stray": Phrase("{n} events with stray timestamps skipped (first: {where})"),
    "recording.events_late": Phrase("{n} events that came too late skipped"),
    "recording.events_sorted": Phrase("{n} places where timestamps decrease by up to 20 ms, sorted"),
    "recording.events_off_sensor": Phrase("{n} events off the sensor skipped (first: {where})"),
    "recording.broken_lines": Phrase("{n} broken lines skipped (first: {where})"),
    "recording.events_beyond_sensors": Phrase("{n} events beyond any sensor skipped"),
    "recording.torn_word": Phrase("{n} bytes of a torn last word skipped"),
    "recording.frames_out_of_order": Phrase("{n} out of order skipped"),
    "recording.points_without_return": Phrase("{n} points without a return"),
    "recording.sent_twice": Phrase("{n} sent twice (equal timestamps)"),
    "recording.out_of_order": Phrase("{n} out of order (timestamps decrease)"),
    "recording.clock_set_back": Phrase("{n} jumps of the clock back by more than 1 s"),
    "recording.not_decoded": Phrase("{n} could not be decoded (first: {where})"),
    "recording.clock_wrapped_31": Phrase("{n} wraps of a 35.8 min clock undone"),
    "recording.clock_wrapped_32": Phrase("{n} wraps of a 71.6 min clock undone"),
}
