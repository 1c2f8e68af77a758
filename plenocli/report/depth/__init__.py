"""Pictures of what has depth: planes of focus, depth maps,
volumes and their kernels.
"""
