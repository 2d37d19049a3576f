"""The surface behind the object in a reference view: completing its disparity (paper 3.3; docs/method.md).

`layers` tells which surfaces round the hole go on behind the object, `fill` continues them, `evidence` is what other
views measured of the hole and see past, `prior` scales a relative depth from outside, `complete` puts them together.
"""

from .complete import DepthCompletion, complete_depth, complete_disparity
from .fill import DepthSettings

__all__ = ["DepthCompletion", "DepthSettings", "complete_depth", "complete_disparity"]
