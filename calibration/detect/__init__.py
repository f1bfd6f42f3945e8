"""Finding targets in pictures: chessboards, plain squares and lights, to sub-pixel and with their uncertainty."""
