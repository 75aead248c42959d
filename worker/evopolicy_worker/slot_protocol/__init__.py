"""Messages between a slot's supervisor and its environment process, and the meaning of each end of one."""
