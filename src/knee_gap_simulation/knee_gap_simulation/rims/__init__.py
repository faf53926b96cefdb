"""The simple scene: two surfaces with sharp rims."""
