"""Colours of what is shown, as red, green and blue from 0 to 255.

Those of Okabe and Ito (2008) are told apart with any colour vision. Here are the ones of them that
stand out from Rerun's dark background and from its light one.
"""

Color = tuple[int, int, int]

ORANGE: Color = (230, 159, 0)
SKY_BLUE: Color = (86, 180, 233)
GREEN: Color = (0, 158, 115)
VERMILION: Color = (213, 94, 0)
PURPLE: Color = (204, 121, 167)
GREY: Color = (130, 130, 130)
"""Of frames, grids and tick labels, and of a curve that is beside the point."""
