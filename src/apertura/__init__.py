"""apertura: campaign folders of UAV-borne digital radar recordings in, georeferenced SAR images out."""

__version__ = "0.1.0"
