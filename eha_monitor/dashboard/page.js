// Names a chart's picture by what it shows, with its title above: a PNG is read far from the page.
window.ehaPicture = function (id, title, subtitle, name) {
  const chart = getElement(id).chart, ratio = 2, head = 46 * ratio;
  const drawn = chart.getRenderedCanvas({pixelRatio: ratio, backgroundColor: '#fff'});
  const whole = document.createElement('canvas');
  whole.width = drawn.width; whole.height = drawn.height + head;
  const pen = whole.getContext('2d');
  pen.fillStyle = '#fff'; pen.fillRect(0, 0, whole.width, whole.height);
  pen.fillStyle = '#1c2529';
  pen.font = `600 ${15 * ratio}px system-ui, "DejaVu Sans", sans-serif`;
  pen.fillText(title, 8 * ratio, 19 * ratio, whole.width - 16 * ratio);
  pen.font = `${12 * ratio}px system-ui, "DejaVu Sans", sans-serif`;
  pen.fillText(subtitle, 8 * ratio, 37 * ratio, whole.width - 16 * ratio);
  pen.drawImage(drawn, 0, head);
  const link = document.createElement('a');
  link.href = whole.toDataURL('image/png'); link.download = name; link.click();
};
// A finger scrolls the page; only a mouse chooses a stretch of time by dragging.
window.ehaDrag = function (id) {
  const box = getElement(id);
  if (!box) return;
  if (!box.chart || !(box.chart.getOption() || {}).toolbox) {
    setTimeout(() => window.ehaDrag(id), 100); return;
  }
  if (window.matchMedia('(pointer: fine)').matches)
    box.chart.dispatchAction({type: 'takeGlobalCursor', key: 'dataZoomSelect',
                              dataZoomSelectActive: true});
};
