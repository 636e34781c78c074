// What a page looks like, written into it as JSON; the first script of a copy of the page.
const trouble = [];
for (const method of ["error", "warn"])
  console[method] = (...told) => trouble.push(told.join(" "));
addEventListener("error", (event) => trouble.push(String(event.message)), true);
addEventListener("securitypolicyviolation", (event) => trouble.push(event.violatedDirective));
addEventListener("load", () => {
  for (const details of document.querySelectorAll("details")) details.open = true;
  const wide = [...document.querySelectorAll("body *")].filter((one) => {
    const box = one.getBoundingClientRect();
    return box.width && box.right > innerWidth + 0.5 && !one.closest(".formula, .matrix, thead");
  });
  const cut = [...document.querySelectorAll(".table, .panels, .keys")].filter(
    (one) => one.scrollWidth > one.clientWidth + 1);
  const size = (one) => parseFloat(getComputedStyle(one).fontSize) *
    Math.hypot(one.getScreenCTM().a, one.getScreenCTM().b);
  const letters = [...document.querySelectorAll(".panels text")].map(size);
  const found = {
    width: innerWidth,
    page: document.documentElement.scrollWidth,
    wide: wide.map((one) => `${one.tagName} ${one.className} ${one.textContent.slice(0, 40)}`),
    cut: cut.map((one) => one.textContent.slice(0, 60)),
    letters: [letters.length, Math.min(...letters)],
    figures: [...document.querySelectorAll("figure")].map((one) => one.outerHTML.length),
    trouble,
  };
  const told = document.createElement("pre");
  told.id = "told";
  told.textContent = JSON.stringify(found);
  document.body.append(told);
});
