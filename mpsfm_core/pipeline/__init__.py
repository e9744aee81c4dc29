"""Run of a reconstruction: this package connects all other packages."""
