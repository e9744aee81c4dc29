"""Rooms, streets and things that are built at random and drawn by casting rays."""
