"""How good a result is: image quality, spectral accuracy, signal to noise, coherence. Arrays in, numbers out."""
