"""Prior extraction on the workers of a Ray cluster."""
