"""neurad: inverse rendering under global illumination with a neural radiometric prior."""

__version__ = "0.1.0"
