"""Files of other programs, one folder a format, reading and writing side by side."""
