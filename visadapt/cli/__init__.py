"""The command `visadapt`."""
