// Fills the page's live figures. Without this script the pictures below them say the same.
(() => {
  const data = JSON.parse(document.getElementById("live-data").textContent);
  const colours = ["#0072B2", "#D55E00", "#009E73", "#CC79A7"];
  const mm = (value) => (value === null ? "–" : value.toFixed(3));
  const box = document.getElementById("live");
  box.hidden = false;
  const panel = (title) => {
    const host = make("div", {});
    box.append(make("h3", {}, title), host);
    return host;
  };
  spaceView(panel(`Gaps${data.parts.some((part) => part.residual.length) ? " and residuals" : ""} in space, method ${data.method}`), data);

  const lines = (values, banded) => data.linear.flatMap((one, m) => ["left", "right"].map((edge) => {
    const rows = one.edge.map((_, i) => i).filter((i) => one.edge[i] === edge);
    const y = rows.map((i) => one[values][i]);
    const half = banded && one.band.length ? rows.map((i) => one.band[i]) : null;
    const beyond = (sign) => half && y.map((value, i) => (value === null || half[i] === null ? null : Math.max(value + sign * half[i], 1e-3)));
    const x = rows.map((i) => one.station[i] / 1000);
    return {
      name: `${one.method}, ${edge}`, colour: colours[m % 4], style: m, thin: edge === "right", x, y,
      low: beyond(-1), high: beyond(1),
      read: (i) => `${one.method}, ${edge} edge, ${x[i].toFixed(2)} m: ${mm(y[i])}${half && half[i] !== null ? ` ± ${mm(half[i])}` : ""} mm`,
    };
  }));
  const known = (values) => data.linear.some((one) => one[values].some((value) => value !== null));
  for (const [values, title] of [["deviation", "as assembled"], ["best_fit", "the bridge moved so that Foot 1 lies best on its design"]]) {
    if (!known(values)) continue;
    const series = lines(values, values === "deviation");
    lineChart(panel(`Linear error, ${title}`), {
      xLabel: "station along the bottom edge, m", yLabel: "linear error, mm", series, logY: data.linear.length > 1,
      note: series.some((one) => one.high) ? "The shaded band holds 95 % or more." : "",
    });
  }
  const trade = data.trade;
  if (trade.lambda.length) {
    const host = panel("Splicing against linear error over the weight lambda");
    const own = trade.lambda.findIndex((value) => Math.abs(value / trade.weight - 1) < 1e-6);
    lineChart(host, {
      xLabel: "splicing error, mm", yLabel: "linear error, mm", logX: true, logY: true,
      series: ["mean", "max"].map((which, k) => ({
        name: which === "mean" ? "mean" : "largest", colour: colours[k], style: k, own, labels: trade.lambda.map(String),
        x: trade[`splicing_${which}`], y: trade[`linear_${which}`],
        read: (i) => `lambda ${trade.lambda[i]}, ${which}: splicing ${mm(trade[`splicing_${which}`][i])} mm, linear ${mm(trade[`linear_${which}`][i])} mm`,
      })),
      note: `The numbers at the points are lambda; the answer's, ${trade.weight}, is ${own < 0 ? "not among them" : "framed"}.`,
    });
  }
})();
