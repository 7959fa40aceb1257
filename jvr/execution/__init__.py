"""Rays over devices, and pictures as blocks of rays."""
