// A part of the page that is drawn anew takes the keyboard's focus with it, and who tabs along would
// begin at the top again: it goes to what has the same name, in the same section.
const KINDS = "button, input, select, [role=tab], [role=slider]";
const nameOf = (e) => (e.getAttribute("aria-label") || e.labels?.[0]?.textContent || e.textContent || "").trim();
const homeOf = (e) => e.closest("section") || document.body;
const alike = (home, name) => [...home.querySelectorAll(KINDS)].filter((e) => nameOf(e) === name);
let last = null;
document.addEventListener("focusin", ({ target }) => {
  const home = homeOf(target), name = nameOf(target);
  last = { home, name, place: alike(home, name).indexOf(target) };
});
document.addEventListener("focusout", ({ target }) => setTimeout(() => {
  if (target.isConnected && document.activeElement === document.body) last = null; // left by a click
}));
addEventListener("DOMContentLoaded", () => new MutationObserver(() => {
  if (last?.home.isConnected && document.activeElement === document.body) {
    alike(last.home, last.name)[last.place]?.focus({ preventScroll: true });
  }
}).observe(document.body, { childList: true, subtree: true }));
