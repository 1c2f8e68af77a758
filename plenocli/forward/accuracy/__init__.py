"""The accuracy dial: what a scene needs, which model serves at the least cost, and why.

Models state their own error and cost (propagation); nothing is computed here.
"""
