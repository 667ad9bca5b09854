"""nuScenes as scenes."""
