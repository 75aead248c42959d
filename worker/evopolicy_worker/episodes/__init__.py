"""Playing episodes, in the environment process of a slot."""
