"""Where providers run: pairs, priors, features, verified matches; cached, resumable, parallel."""
