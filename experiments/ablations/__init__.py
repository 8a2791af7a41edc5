"""The paper's ablations of tracking, and ours: what each part is worth, measured by leaving it out."""
