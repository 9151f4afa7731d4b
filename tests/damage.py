"""Damaged files, for the property test of each reader."""

from hypothesis import strategies as st


def damaged(whole):
    """Cut a file short at any byte, or change one of its bytes."""

    def changed(at, mask):
        return whole[:at] + bytes([whole[at] ^ mask]) + whole[at + 1 :]

    places = st.integers(0, len(whole) - 1)
    return places.map(lambda n_bytes: whole[:n_bytes]) | st.builds(changed, places, st.integers(1, 255))
