"""What a scene is: geometry, materials, lights and views, and the readers of scene files."""
