"""Files of others, in and out: recordings, flight logs, phase histories, DEMs; GeoTIFF, CPHD, STAC, RO-Crate.

`names` states which file is of which format and imports no reader; `reading` calls the reader. A new format is one file
and one row. Imports `apertura.common` and `apertura.core`; never opens a campaign, and no format knows another.
"""
