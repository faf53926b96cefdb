"""The base of every package: values, bags, nodes, and the compilation of kernels."""
