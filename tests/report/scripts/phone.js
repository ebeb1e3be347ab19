// Tells the page around the frame how the page in the frame came out.
window.addEventListener('load', function () {
  setTimeout(function () {
    var root = document.documentElement, sizes = [], outside = [], small = [];
    function look(node) {
      var box = node.getBoundingClientRect();
      if (box.right > root.clientWidth + 1 && !node.closest('.scroll')) {
        outside.push(node.tagName + '.' + node.getAttribute('class'));
      }
      var size = parseFloat(getComputedStyle(node).fontSize);
      if (node.childElementCount === 0 && node.textContent.trim()) {
        sizes.push(size);
        if (size < 9) { small.push(node.textContent); }
      }
    }
    document.body.querySelectorAll('*:not(script):not(defs *)').forEach(look);
    var plots = Array.prototype.slice.call(document.querySelectorAll('.drawing'));
    parent.postMessage(JSON.stringify({
      width: root.clientWidth, needed: root.scrollWidth, outside: outside.slice(0, 5),
      smallest: Math.min.apply(null, sizes), small: small.slice(0, 5), plots: plots.length,
      drawn: plots.filter(function (p) { return p.querySelector('svg.main-svg'); }).length,
      narrowest: Math.min.apply(null, plots.map(function (p) {
        return p.querySelector('svg.main-svg').getBoundingClientRect().width; }))
    }), '*');
  }, 1500);
});
