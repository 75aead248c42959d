"""The interface to every environment: spaces, actions, observations and rewards as values, and the Gymnasium
adapter."""
