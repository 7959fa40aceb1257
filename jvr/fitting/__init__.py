"""From pictures back to the scene."""
