"""The state of a reconstruction and its finished form."""
