"""What every package stands on: values, bags, nodes, and the compilation of kernels."""
