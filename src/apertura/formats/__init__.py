"""Readers and writers of file formats: recordings, flight logs, phase histories, DEMs; GeoTIFF, CPHD, STAC, RO-Crate.

`names` maps files to formats without importing readers; `reading` calls the readers. A new format takes one file and
one table row. Imports `apertura.common` and `apertura.core`, never opens a campaign; formats do not depend on each
other.
"""
