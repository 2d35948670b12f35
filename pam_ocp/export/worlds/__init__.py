"""A plant in other worlds (JAX, PyTorch, ONNX, MuJoCo, Modelica): a file each, one registry."""
