"""What a person looks at after a fit: figures and one HTML page."""
