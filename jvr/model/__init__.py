"""What a scene is made of: pytrees whose leaves are arrays. Nothing here marches."""
