"""What recipes that train on a data set share: fields, the loop of gradient steps, its state."""
