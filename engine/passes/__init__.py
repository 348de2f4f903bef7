"""From views to layers: EXR, Cryptomatte, previews, splats, and the arrays of a result."""
