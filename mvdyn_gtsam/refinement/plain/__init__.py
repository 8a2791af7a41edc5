"""Plain surfaces, of which no flow tells the depth: planes of their rims, agreed between frames."""
