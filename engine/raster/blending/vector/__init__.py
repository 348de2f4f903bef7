"""The vector kernels: sixteen pixels of a patch at a time. Their plain twins are in the folder above."""
