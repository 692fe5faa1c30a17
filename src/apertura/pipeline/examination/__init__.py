"""What a log, a recording, phase history or a DEM says of itself, as plain values; `check` and `inspect` print them.

`times` has spans, rates, gaps and overlaps, `facts` has the values of one file, and `campaign` opens the files of a
campaign folder once. Judges nothing and shows nothing to people.
"""
