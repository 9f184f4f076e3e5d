// Sets what stands in blocks of ```math, with KaTeX.
for (const code of document.querySelectorAll('code.language-math')) {
  const formula = document.createElement('div');
  formula.className = 'formula';
  katex.render(code.textContent, formula, { displayMode: true, throwOnError: false });
  code.parentElement.replaceWith(formula);
}
