"""Training of the project's own network: examples, augmentation, model, fit, ONNX file."""
