"""Scores, and the tables that hold them."""
