"""From rendered views to files: EXR, Cryptomatte, previews, splats, and the arrays of a result."""
