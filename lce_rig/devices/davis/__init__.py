"""DAVIS event cameras through dv-processing."""
