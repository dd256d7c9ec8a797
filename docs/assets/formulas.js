// Draws what docs/formulas.py marked; without it a page shows TeX.
for (const element of document.querySelectorAll('.formula')) {
  katex.render(element.textContent.slice(2, -2), element, {
    displayMode: element.tagName === 'DIV', throwOnError: false,
  });
}
