"""Version of this package. Servers of the same major and minor version fit."""

__version__ = "0.1.0"
