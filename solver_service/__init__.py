"""Match two nodes' candidates, reject outliers, solve the relative pose, publish it."""
