"""3D-GIMP: object removal for Gaussian splat scenes (see README)."""

import os

__version__ = "0.1.0"

# Before OpenCV is imported: a picture's header may claim any size, and what is wrong with one is said by us.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(1 << 27))
os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
