"""What a fit is judged by: held-out views, their ground truth, and scores over pooled pixels."""
