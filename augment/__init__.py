"""ClimateGS: weather for driving scenes made of 3D Gaussians."""

__version__ = "0.1.0"
