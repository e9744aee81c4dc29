"""The uncertainty model of priors, fitting it, and its report."""
