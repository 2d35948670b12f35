"""A plant in other worlds: JAX, PyTorch, ONNX, MuJoCo, Modelica, each in one file behind a registry."""
