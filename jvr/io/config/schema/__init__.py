"""The tables and keys of a configuration. Numbers are checked here, with their units; objects are made in `build`.

Lengths are millimetres where the volume's file says so; a file without a unit defines its own.
"""
