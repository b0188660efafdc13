"""From a recording to axes, biases, noise and delays."""
