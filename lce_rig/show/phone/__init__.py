"""A page that shows a live collection to the person who holds the board, on a phone or a big screen."""
