"""Pages that explain results to people: one self-contained HTML file each, for screen, phone and paper."""
