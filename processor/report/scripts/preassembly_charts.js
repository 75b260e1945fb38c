// Linear error along the bottom edges, and the trade-off over lambda. `panel(title)` adds a host element to the page.
function preassemblyCharts(panel, data) {
  const colours = ["#0072B2", "#D55E00", "#009E73", "#CC79A7"];
  const lines = (values, band) => data.linear.flatMap((one, m) => ["left", "right"].map((edge) => {
    const rows = one.edge.map((_, i) => i).filter((i) => one.edge[i] === edge);
    const y = rows.map((i) => one[values][i]);
    const half = one[band].length ? rows.map((i) => one[band][i]) : null;
    const beyond = (sign) => half && y.map((value, i) => (value === null || half[i] === null ? null : Math.max(value + sign * half[i], 1e-3)));
    const x = rows.map((i) => one.chainage[i] / 1000);
    return {
      name: `${one.method}, ${say(edge)}`, colour: colours[m % 4], style: m, further: m > 0, thin: edge === "right", x, y,
      low: beyond(-1), high: beyond(1),
      read: (i) => `${one.method}, ${say(edge === "left" ? "left edge" : "right edge")}, ${x[i].toFixed(2)} m: ${millimetres(y[i])}${half && half[i] !== null ? ` ± ${millimetres(half[i])}` : ""} mm`,
    };
  }));
  const known = (values) => data.linear.some((one) => one[values].some((value) => value !== null));
  for (const [values, band, title] of [
    ["deviation", "band", "Linear error, as assembled"],
    ["best_fit", "best_fit_band", "Linear error, the bridge moved so that Foot 1 lies best on its design"],
  ]) {
    if (!known(values)) continue;
    const series = lines(values, band);
    lineChart(panel(say(title)), {
      xLabel: say("chainage along the bottom edge, m"), yLabel: say("linear error, mm"), series, logY: false,
      note: series.some((one) => one.high) ? say("The shaded band holds 95 % or more.") : "",
    });
  }
  const trade = data.trade;
  if (!trade.lambda.length) return;
  const chosen = trade.lambda.findIndex((value) => Math.abs(value / trade.weight - 1) < 1e-6);
  lineChart(panel(say("Splicing against linear error over the weight lambda")), {
    xLabel: say("splicing error, mm"), yLabel: say("linear error, mm"), logX: true, logY: true,
    series: ["mean", "max"].map((which, k) => ({
      name: say(which === "mean" ? "mean" : "largest"), colour: colours[k], style: k, own: chosen, labels: trade.lambda.map(String),
      x: trade[`splicing_${which}`], y: trade[`linear_${which}`],
      read: (i) => `lambda ${trade.lambda[i]}: ${say("splicing")} ${millimetres(trade[`splicing_${which}`][i])} mm, ${say("linear")} ${millimetres(trade[`linear_${which}`][i])} mm`,
    })),
    note: chosen < 0 ? "" : `${say("The numbers at the points are lambda; that of the result is framed:")} ${trade.weight}`,
  });
}
