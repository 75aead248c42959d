"""What a slot's supervisor and its environment process say to each other, and what each end of one means."""
