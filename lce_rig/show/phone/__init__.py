"""A page that shows a live collection to the person with the board, on a phone or a big screen."""
