"""The decoders as compiled kernels, which compute all neural Gaussians of a view, and their gradients.
``engine.model.torch_decoding`` does the same in readable form; with it, a whole ``preview`` lift of the sample takes a
third longer (docs/development.md)."""
