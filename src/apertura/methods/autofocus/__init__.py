"""Autofocus: tracks refined by the image itself, with acceptance by patches that were not fitted."""
