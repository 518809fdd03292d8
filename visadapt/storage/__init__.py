"""Files that are written whole or not at all: atomic files, checkpoints, run folders."""
