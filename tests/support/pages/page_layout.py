"""What of a page cannot be reached in a browser: measured on the page as laid out, with everything unfolded."""

FAULTS = """() => {
  const faults = [], width = document.documentElement.clientWidth;
  document.querySelectorAll('details').forEach((one) => { one.open = true; });
  if (document.documentElement.scrollWidth > width) faults.push('the page is wider than the window');
  const styled = (element, test) => {
    for (let at = element; at; at = at.parentElement) if (test(at, getComputedStyle(at))) return at;
    return null;
  };
  const scrolls = (at, style) => /auto|scroll/.test(style.overflowX) && at.scrollWidth > at.clientWidth + 1;
  const hides = (at, style) => /hidden|clip/.test(style.overflowX) || /hidden|clip/.test(style.overflowY);
  for (const element of document.querySelectorAll('table, img, svg, canvas, pre')) {
    const box = element.getBoundingClientRect(), about = styled(element.parentElement, hides);
    const name = `${element.tagName} ${element.textContent.trim().slice(0, 40)}`;
    if (!box.width) continue;
    if (box.right > width + 1 && !styled(element, scrolls)) faults.push(`beyond the window: ${name}`);
    const edge = about && about.getBoundingClientRect();
    if (edge && (box.right > edge.right + 1 || box.bottom > edge.bottom + 1)) faults.push(`cut by its box: ${name}`);
  }
  for (const cell of document.querySelectorAll('td, th')) {
    const cut = getComputedStyle(cell).overflowX !== 'visible' && cell.scrollWidth > cell.clientWidth + 1;
    if (cut) faults.push(`cut cell: ${cell.textContent.trim().slice(0, 40)}`);
  }
  return faults;
}"""


def faults(shown):
    """Tables, pictures and cells of a page that are cut or lie beyond the window without a scroll bar, in words."""
    return shown.evaluate(FAULTS)
