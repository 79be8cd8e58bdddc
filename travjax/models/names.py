"""The estimators by name."""

RESNET, FIELD = "resnet50", "field"
MODELS = (RESNET, FIELD)
"""Of one trajectory at a time, and of all trajectories of a map at once."""

FOLDERS = {RESNET: "train", FIELD: "field"}
"""Of each model's runs, under runs/; its presets lie in a folder of the model's name."""
