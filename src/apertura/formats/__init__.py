"""Readers and writers of file formats: recordings, flight logs, phase histories, DEMs; GeoTIFF, CPHD, STAC, RO-Crate.

`names` maps files to formats without importing readers; `reading` calls the readers. A new format requires one module
and one table row. The package imports `apertura.common` and `apertura.core`, and does not open campaigns. Formats do
not depend on each other.
"""
