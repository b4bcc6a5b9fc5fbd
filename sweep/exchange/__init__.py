"""Images for other programs, and their answers: ``sweep export`` and ``sweep score``."""
