"""Wave optics: from the camera's description to the system matrix A."""
