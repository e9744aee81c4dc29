"""Detection of wrong poses and pairs by depth and matches."""
