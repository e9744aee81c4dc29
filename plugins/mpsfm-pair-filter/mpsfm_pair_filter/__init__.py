"""Filter of image pairs by scores from a file."""
