"""What plugin authors and our own tests use: analytic scenes and contract checks."""
