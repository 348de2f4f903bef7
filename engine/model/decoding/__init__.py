"""The decoders as compiled kernels: values and gradients of all neural Gaussians of a view in two passes.

The readable counterpart of everything here is ``engine.model.torch_decoding``, with which a whole ``preview`` lift of
the sample takes a third longer (docs/development.md).
"""
