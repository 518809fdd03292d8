"""Atomic files, checkpoints, run folders."""
