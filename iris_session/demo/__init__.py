"""Demos: scenes that come with the package, who does what in them, and running one as a whole session."""
