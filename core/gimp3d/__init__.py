"""3D-GIMP: object removal for Gaussian splat scenes (see README)."""

__version__ = "0.1.0"
