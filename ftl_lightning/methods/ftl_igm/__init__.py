"""Our method (the paper's FTL-IGM): a conditional diffusion model whose concepts are learned by gradient descent."""
