"""From a scene and a camera to a picture."""
