"""One file a command: read artefacts, call kernels, write artefacts. The only room where files meet mathematics."""
