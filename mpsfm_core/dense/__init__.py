"""Dense geometry of a finished reconstruction: multi-view depth with honest variance."""
