def text(fit, truth): raise NotImplementedError
