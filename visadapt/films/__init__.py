"""Films and stills of runs."""

from visadapt.films.filming import film

__all__ = ["film"]
