"""Extraction runs all providers: features, pairs, verified matches and priors."""
