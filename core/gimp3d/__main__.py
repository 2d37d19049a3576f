"""python -m gimp3d"""

from .cli import entry_point

entry_point()
