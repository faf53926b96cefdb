"""What the scope sees and where it is: edges of the instrument gap and the pose of the lens."""
