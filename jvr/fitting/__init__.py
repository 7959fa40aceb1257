"""Inverse rendering: from pictures back to the scene."""
