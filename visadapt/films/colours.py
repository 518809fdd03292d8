"""The colours of films and plots, one list."""

Colour = tuple[int, int, int]
"""Red, green, blue, 0 to 255."""

PAPER: Colour = (255, 255, 255)
INK: Colour = (31, 41, 51)
MUTED: Colour = (110, 122, 136)
HAIRLINE: Colour = (216, 221, 227)
TROUGH: Colour = (236, 239, 243)
BLUE: Colour = (47, 103, 201)
ORANGE: Colour = (222, 116, 22)
TEAL: Colour = (14, 122, 112)
RED: Colour = (190, 42, 42)
AMBER: Colour = (232, 168, 48)
VIOLET: Colour = (122, 62, 168)
"""The hidden force on a vehicle."""
ROSE: Colour = (226, 172, 168)
"""An earlier flight, drawn for comparison."""
SKY: Colour = (250, 252, 254)
GROUND: Colour = (238, 241, 240)
AIRFRAME: Colour = (226, 231, 238)


def blend(one: Colour, other: Colour, share: float) -> Colour:
    """The colour a share of the way from one to the other."""
    red, green, blue = (round(a + (b - a) * share) for a, b in zip(one, other, strict=True))
    return red, green, blue


def hexadecimal(colour: Colour) -> str:
    """The colour as matplotlib writes it: #rrggbb."""
    return "#{:02x}{:02x}{:02x}".format(*colour)
