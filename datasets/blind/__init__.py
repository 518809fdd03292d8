"""Recordings with hidden effects, made by code apart from the library."""
