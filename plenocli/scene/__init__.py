"""What is in front of the camera: charts, light, photographs, spectral images and their statistics."""
