"""The effects that come with the library: other tests register some of systems of their own."""

from visadapt.effects import EFFECTS

LIBRARY = {name: effect for name, effect in EFFECTS.items() if effect.__module__.startswith("visadapt.")}
