"""Filter of image pairs by similarity scores from a file."""
