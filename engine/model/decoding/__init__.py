"""The decoders as compiled kernels: values and gradients of all neural Gaussians of a view in two passes.

The readable twin of everything here is ``engine.model.torch_decoding``.
"""
