"""Files in and out: volumes, images, configs."""
