// The last seconds of something that runs: what is reached, what is to be reached, and inputs
// below. The reference is dragged up and down at the right edge, or moved by arrow keys.
const M = { left: 62, right: 26, top: 8, gap: 14, bottom: 34 };
function ticks(low, high) {
  const raw = (high - low || 1) / 4, power = Math.pow(10, Math.floor(Math.log10(raw)));
  const step = [1, 2, 5, 10].map((m) => m * power).find((s) => s >= raw * 0.999), found = [];
  for (let v = Math.ceil(low / step - 1e-9) * step; v <= high + 1e-9 * step; v += step) found.push(Math.abs(v) < 1e-9 * step ? 0 : v);
  return found;
}
export default {
  template: `
    <div class="bench-strip" ref="box">
      <svg :width="width" :height="height" ref="svg" role="group" :aria-label="label"
        @pointermove="move" @pointerup="drop" @pointercancel="drop">
        <g v-for="p in panes" :key="p.name">
          <rect class="stops-paper" :x="M.left" :y="p.top" :width="w" :height="p.h" />
          <g v-for="k in p.ticks"><line class="stops-grid" :x1="M.left" :x2="M.left + w" :y1="p.Y(k)" :y2="p.Y(k)" />
            <text class="stops-text" :x="M.left - 6" :y="p.Y(k) + 4" text-anchor="end">{{ Number(k.toPrecision(4)) }}</text></g>
          <text class="stops-text" transform="rotate(-90)" :x="-(p.top + p.h / 2)" y="14" text-anchor="middle">{{ p.name }} [{{ p.unit }}]</text>
          <polyline v-for="c in p.curves" :key="c.name" class="strip-curve" :points="c.points" :style="{ stroke: c.colour, strokeDasharray: c.dash }" />
        </g>
        <text class="stops-text" :x="M.left + w / 2" :y="height - 4" text-anchor="middle">time [s]</text>
        <text class="stops-text" :x="M.left" :y="height - 18" text-anchor="start">{{ Math.max(0, now - span).toFixed(1) }}</text>
        <text class="stops-text" :x="M.left + w" :y="height - 18" text-anchor="end">{{ Math.max(now, span).toFixed(1) }}</text>
        <g class="stops-stop" tabindex="0" role="slider" aria-orientation="vertical" aria-label="reference" :aria-valuemin="low" :aria-valuemax="high"
          :aria-valuenow="wanted.toFixed(4)" :aria-valuetext="Number(wanted.toFixed(4)) + ' ' + unit" @pointerdown="take" @keydown="key">
          <polygon class="stops-dot" :points="handle" />
        </g>
      </svg>
    </div>`,
  props: { low: Number, high: Number, unit: String, variable: String, inputs: Array, reference: Number, span: { type: Number, default: 6 }, label: String },
  data() { return { M, width: 700, height: 330, t: [], rows: {}, wanted: this.reference, held: false }; },
  mounted() {
    this.watcher = new ResizeObserver(() => { if (this.$refs.box && this.$refs.box.clientWidth) this.width = this.$refs.box.clientWidth; });
    this.watcher.observe(this.$refs.box);
  },
  unmounted() { this.watcher.disconnect(); },
  computed: {
    w() { return Math.max(50, this.width - M.left - M.right); },
    now() { return this.t.length ? this.t[this.t.length - 1] : 0; },
    panes() {
      const free = this.height - M.top - M.gap - M.bottom, h1 = Math.round(0.6 * free), h2 = free - h1;
      const begin = Math.max(0, this.now - this.span), X = (t) => M.left + ((t - begin) / this.span) * this.w;
      const pane = (name, unit, top, h, low, high, curves) => {
        const pad = 0.06 * (high - low || 1), Y = (v) => top + ((high + pad - v) / (high - low + 2 * pad)) * h;
        return { name, unit, top, h, Y, ticks: ticks(low, high), curves: curves.map((c) => ({
          ...c, points: (this.rows[c.name] || []).map((v, i) => X(this.t[i]).toFixed(1) + "," + Y(v).toFixed(1)).join(" "),
        })) };
      };
      const ins = this.inputs || [];
      const all = [pane(this.variable, this.unit, M.top, h1, this.low, this.high, [
        { name: "reference", colour: "var(--soft)", dash: "5 4" }, { name: this.variable, colour: "var(--accent)", dash: "" }])];
      if (ins.length) all.push(pane(ins.length > 1 ? "inputs" : ins[0].name, ins[0].unit, M.top + h1 + M.gap, h2,
        Math.min(...ins.map((i) => i.low)), Math.max(...ins.map((i) => i.high)), ins));
      return all;
    },
    handle() {
      const x = M.left + this.w + 3, y = this.panes[0].Y(this.wanted);
      return [x, y, x + 16, y - 9, x + 16, y + 9].join(" ");
    },
  },
  watch: { reference(v) { if (!this.held) this.wanted = v; } },
  methods: {
    add(c) {
      if (c.restart) { this.t = []; this.rows = {}; }
      const t = this.t.concat(c.t), keep = t.findIndex((v) => v > t[t.length - 1] - this.span), rows = {};
      for (const name in c.rows) rows[name] = (this.rows[name] || []).concat(c.rows[name]).slice(keep);
      this.t = t.slice(keep); this.rows = rows;
    },
    take(event) { event.preventDefault(); event.currentTarget.focus(); this.held = true; this.$refs.svg.setPointerCapture(event.pointerId); },
    move(event) {
      if (!this.held) return;
      const p = this.panes[0], y = event.clientY - this.$refs.svg.getBoundingClientRect().top, pad = 0.06 * (this.high - this.low);
      this.say(this.high + pad - ((y - p.top) / p.h) * (this.high - this.low + 2 * pad));
    },
    drop() { this.held = false; this.$emit("reference", this.wanted); },
    key(event) {
      const by = { ArrowUp: 1, ArrowDown: -1, PageUp: 10, PageDown: -10 }[event.key];
      if (by) { event.preventDefault(); this.say(this.wanted + 0.01 * by * (this.high - this.low)); this.$emit("reference", this.wanted); }
    },
    say(v) {
      this.wanted = Math.min(this.high, Math.max(this.low, v));
      const now = performance.now();
      if (now - (this.at || 0) > 40) { this.at = now; this.$emit("reference", this.wanted); }
    },
  },
};
