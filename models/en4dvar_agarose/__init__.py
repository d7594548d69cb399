"""The paper's study of agarose: parameter sweep, En4D-Var, tables, figures, population, on any campaign of bubbles."""
