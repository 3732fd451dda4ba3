"""Machine code by LLVM: scalar nodes as its text, and that as functions."""
