"""Files: recordings, model files, atomic writes, sandboxed readers."""
